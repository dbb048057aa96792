"""The command ``pilotage``."""

import importlib
import signal
import sys

import typer
from typer.core import TyperCommand, TyperGroup
from typer.exceptions import TyperException
from typer.main import get_group

from pipeline.errors import PilotageError
from workflows.exits import EXIT_INTERRUPTED, EXIT_NOT_STARTED

# Where each command is found. Only what is asked for is loaded: the science takes two seconds, which a question to a
# run's files should not wait for.
_PLACES = {
    "plan": ("workflows.run_cli", "plan"),
    "run": ("workflows.run_cli", "run"),
    "status": ("workflows.status_cli", "status"),
    "show": ("workflows.run_cli", "show"),
    "report": ("workflows.report_cli", "report"),
    "query": ("workflows.query_cli", "query"),
    "picture": ("workflows.picture_cli", "picture"),
    "validate": ("workflows.validate_cli", "validate"),
    "doctor": ("workflows.doctor_cli", "doctor"),
    "ck": ("workflows.run_cli", "ck"),
    "pose": ("workflows.pose_cli", "pose"),
    "config": ("workflows.config_cli", "app"),
    "catalog": ("workflows.catalog_cli", "app"),
    "sample": ("workflows.sample_cli", "app"),
}


def _plain(group: type[TyperGroup] | None = None) -> typer.Typer:
    """An application that prints errors as this one does."""
    return typer.Typer(
        name="pilotage", cls=group, add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False
    )


# Typer keeps the type of its contexts' common parent to itself; all of ours are of the one that it shows.
class _Commands(TyperGroup):
    """The commands, each loaded when it is named."""

    def list_commands(self, ctx: typer.Context) -> list[str]:  # type: ignore[override]
        """Names, in the order of their use."""
        return list(_PLACES)

    def get_command(  # type: ignore[override]
        self, ctx: typer.Context, cmd_name: str
    ) -> TyperCommand | TyperGroup | None:
        """Load one command; None where there is none of that name."""
        if cmd_name not in _PLACES:
            return None
        module, name = _PLACES[cmd_name]
        found, holder = getattr(importlib.import_module(module), name), _plain()
        if isinstance(found, typer.Typer):
            holder.add_typer(found, name=cmd_name)
        else:
            holder.command(cmd_name)(found)
        loaded = get_group(holder).commands[cmd_name]
        assert isinstance(loaded, TyperCommand | TyperGroup)
        return loaded


app = _plain(_Commands)


@app.callback()
def _about() -> None:
    """Navigate archives of planetary images: pointing offsets, rotations and uncertainties that hold."""


def main() -> None:
    """Entry point: one line per error, and exit codes that scripts can rely on."""
    # A pipe that is closed early (`| head`) ends the program quietly, as for any Unix tool.
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    try:
        # Who says nothing wants to be told what can be said.
        code = app(sys.argv[1:] or ["--help"], standalone_mode=False)
        if code == EXIT_INTERRUPTED:
            raise KeyboardInterrupt
    except TyperException as error:
        code = _complain(f"{error.format_message()} (see pilotage --help)")
    except OSError as error:
        # Full disks and lost mounts: no fault of any one image, so the run has stopped.
        code = _complain(f"{error.filename or 'input or output'}: {error.strerror or error}")
    except PilotageError as error:
        code = _complain(str(error))
    except (KeyboardInterrupt, typer.Abort):
        typer.echo("pilotage: interrupted; run the same command again to go on", err=True)
        code = EXIT_INTERRUPTED
    sys.exit(code if isinstance(code, int) else 0)


def _complain(text: str) -> int:
    typer.echo(f"pilotage: {' '.join(text.split())}", err=True)
    return EXIT_NOT_STARTED


if __name__ == "__main__":
    main()
