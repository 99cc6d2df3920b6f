#!/usr/bin/env bash
# What `straitlink link --guest` needs: a kernel in user mode with its modules, and the tools to set up its
# network. Debian and its kin; as root.
set -euo pipefail
apt-get update --quiet
DEBIAN_FRONTEND=noninteractive apt-get install --yes --quiet --no-install-recommends \
  user-mode-linux kmod iproute2 iputils-ping
