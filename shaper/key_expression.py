"""Zenoh key expressions, matched without Zenoh: which rule a key belongs to.

A key is chunks joined by "/". In an expression `*` is any one chunk, `**` any number of chunks (none
too), `$*` any characters inside a chunk; a chunk that starts with "@" is matched only by itself.
Source: the Zenoh key expression RFC (eclipse-zenoh/roadmap, "Key Expressions") and the behaviour of
eclipse-zenoh 1.10, which the tests compare with.
"""

from __future__ import annotations

import re
from functools import lru_cache


def check_key_expression(text: str) -> str | None:
    """What is wrong with an expression, as the end of a sentence; None if it is well formed."""
    if not text:
        return "a key expression is not empty"
    chunks = text.split("/")
    if "" in chunks:
        return "a key expression has no leading, trailing or double slash"
    for chunk in chunks:
        if re.search(r"[?#]", chunk):
            return "a key expression holds no ? and no #"
        if chunk not in ("*", "**") and re.search(r"\*", chunk.replace("$*", "")):
            return "a wildcard is a whole chunk (* or **) or $* inside one"
        if "$" in chunk.replace("$*", ""):
            return "$ stands only before * in a key expression"
        if chunk == "$*" or "$*$*" in chunk:
            return "$* stands beside other characters of its chunk, once in each place; a whole chunk is *"
    if re.search(r"(^|/)\*\*/\*", text):
        return "** is not followed by * or **: write */** for one chunk or more"
    return None


def is_key(text: str) -> bool:
    """Whether the text names one key: well formed and without wildcards."""
    return "*" not in text and check_key_expression(text) is None


@lru_cache(maxsize=4096)
def _pattern(expression: str) -> re.Pattern[str]:
    # Each chunk carries its slash, so that ** may stand for no chunk at all: "a/**" matches "a".
    pieces = []
    for chunk in expression.split("/"):
        if chunk == "**":
            pieces.append(r"(?:/(?!@)[^/]+)*")
        elif chunk == "*":
            pieces.append(r"/(?!@)[^/]+")
        elif chunk.startswith("@"):
            pieces.append("/" + re.escape(chunk))
        else:
            inside = "[^/]*".join(re.escape(part) for part in chunk.split("$*"))
            verbatim_guard = "(?!@)" if chunk.startswith("$*") else ""
            pieces.append("/" + verbatim_guard + inside)
    return re.compile("".join(pieces))


def matches(expression: str, key: str) -> bool:
    """Whether a key belongs to an expression."""
    return _pattern(expression).fullmatch("/" + key) is not None
