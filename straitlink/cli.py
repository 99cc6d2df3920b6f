"""The `straitlink` command: puts the commands together; our errors end in one line and exit code 2."""

from __future__ import annotations

import sys

import typer

from straitlink.commands.chaos import app as chaos_app
from straitlink.commands.demo import app as demo_app
from straitlink.commands.keygen import app as keygen_app
from straitlink.commands.link import app as link_app
from straitlink.commands.live import app as live_app
from straitlink.commands.messages import app as messages_app
from straitlink.commands.perception import app as perception_app
from straitlink.commands.recordings import app as recordings_app
from straitlink.commands.virtual import app as virtual_app

app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)
for commands in (
    demo_app,
    live_app,
    link_app,
    keygen_app,
    chaos_app,
    virtual_app,
    recordings_app,
    perception_app,
):
    app.registered_commands += commands.registered_commands
app.add_typer(messages_app, name="messages")

EXIT_USAGE = 2  # a setting, a file or an address that cannot be


@app.callback()
def straitlink() -> None:
    """Operate robots over links that are thin, slow, changing and broken."""


def main() -> None:
    """Entry point of the console script."""
    try:
        app()
    except OSError as error:
        if error.filename is None:
            raise
        typer.echo(f"straitlink: {error.filename}: {error.strerror}", err=True)
        sys.exit(EXIT_USAGE)
    except Exception as error:
        from straitlink.errors import user_errors

        if not isinstance(error, user_errors()):
            raise
        typer.echo(f"straitlink: {error}", err=True)
        sys.exit(EXIT_USAGE)
