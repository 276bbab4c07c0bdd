"""Entry point of the command line: the commands, and the messages and exit codes of errors.

Exit codes: see ``EXIT_CODES``.
"""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Callable
from typing import Annotated, NoReturn

import typer

from cli.batch import batch
from cli.compare import compare
from cli.console import say_error
from cli.diff import diff
from cli.evaluate import evaluate
from cli.infer import infer
from cli.integrate import integrate
from cli.log import log
from cli.merge import merge
from cli.plain_help import PlainCommand
from cli.report import report
from cli.scenes import scenes
from cli.train import train
from cli.view import view
from cli.weights import weights
from predmapnet.errors import UserError

EXIT_CODES = """\b
Exit codes:
  0    done
  1    some scenes of a batch failed; maps differ (diff --exit-code)
  2    a wrong option or a broken input: the message names it
  3    a fault of PredMapNet itself
  130  stopped with Ctrl-C"""

DISK_IS_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}

app = typer.Typer(
    name="predmapnet",
    help="From driving logs to clean vector maps. Start with:\n\npredmapnet infer scene-0103 --out map.geojson",
    epilog=EXIT_CODES,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # plain help, whole at any width
    context_settings={"help_option_names": ["-h", "--help"]},
)
COMMANDS: tuple[Callable[..., None], ...] = (
    infer,
    view,
    batch,
    scenes,
    evaluate,
    compare,
    train,
    integrate,
    merge,
    report,
    diff,
)
for command in COMMANDS:
    app.command(cls=PlainCommand)(command)
app.add_typer(log)
app.add_typer(weights)


def _version(wanted: bool) -> None:
    if wanted:
        from predmapnet import __version__

        typer.echo(f"predmapnet {__version__}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and exit.")
    ] = False,
    debug: Annotated[
        bool, typer.Option("--debug", envvar="PREDMAPNET_DEBUG", help="Show tracebacks instead of messages.")
    ] = False,
) -> None:
    """Options of all commands."""
    if debug:
        os.environ["PREDMAPNET_DEBUG"] = "1"


def main() -> None:
    """Run a command; turn errors into one message and an exit code."""
    try:
        app(prog_name="predmapnet")
    except SystemExit as end:
        if end.code == 130:
            say_error("stopped; files that were not finished have been removed")
        raise
    except UserError as error:
        _fail(str(error), error)
    except OSError as error:
        where = f" ({error.filename})" if error.filename else ""
        if error.errno in DISK_IS_FULL:
            _fail(f"the disk is full{where}; make room and run the command again", error)
        _fail(f"{(error.strerror or str(error)).lower()}{where}", error)
    except Exception as error:
        reason = f"{type(error).__name__}: {error}"
        _fail(f"this is a bug in PredMapNet ({reason}); predmapnet --debug ... shows the traceback", error, 3)


def _fail(message: str, error: Exception, code: int = 2) -> NoReturn:
    if os.environ.get("PREDMAPNET_DEBUG"):
        raise error
    say_error(message)
    sys.exit(code)


if __name__ == "__main__":
    main()
