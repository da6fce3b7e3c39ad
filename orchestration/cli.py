"""The command line: ``submin COMMAND``; the commands themselves are in `orchestration.commands`.

Exit codes: 0 done; 1 done in part (some blocks rejected; each is named with its reason); 2 wrong usage or bad input, nothing written,
or the cluster was lost (what was committed stays); 130 and 143 stopped by Ctrl-C and by SIGTERM (what was committed stays).
"""

from __future__ import annotations

import json
import sys
from typing import NoReturn

import typer
from rich.console import Console

from orchestration.commands import ask, cameras, change, export, health, imports, plan, points, simulate
from orchestration.stopping import Stopped, signals_stop

app = typer.Typer(
    no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False, rich_markup_mode="rich",
    help="Ground-control networks for a continent: blocks of satellite images in, control points with joint covariance out.",
)  # fmt: skip
app.add_typer(imports.app, name="import")
app.add_typer(simulate.app, name="simulate")
for module in (change, plan, cameras, ask, points, export, health):
    app.add_typer(module.app)

USAGE_ERROR: type[typer.BadParameter] = typer.BadParameter.__mro__[1]
"""Base of all that the parser raises; newer releases of typer keep it in a private package."""


def main() -> None:
    """Run the command line; an error, or a signal to stop, is one line on standard error."""
    try:
        with signals_stop():
            from submin.errors import SubminError  # the first import that takes time

            try:
                sys.exit(app(prog_name="submin", standalone_mode=False))
            except (SubminError, OSError, USAGE_ERROR) as error:
                _fail(" ".join(_message(error).split()), 2)
            except Exception as error:
                from submin.storage.place import unreadable

                said = unreadable(error)
                if said is None:
                    raise
                _fail(" ".join(str(said).split()), 2)
    except Stopped as stopped:
        _fail(str(stopped), stopped.exit_code)


def _fail(message: str, code: int) -> NoReturn:
    if message:  # a group of commands without one has printed its help
        Console(stderr=True, highlight=False, markup=False).print(f"submin: {message}", soft_wrap=True)
    if "--json" in sys.argv:
        sys.stdout.write(json.dumps({"error": message}) + "\n")
    sys.exit(code)


def _message(error: Exception) -> str:
    if isinstance(error, OSError):
        name = f"{error.filename}: " if error.filename else ""
        return f"{name}cannot be read or written ({error.strerror or error}); check path, permissions and free space"
    if isinstance(error, USAGE_ERROR):
        context, said = getattr(error, "ctx", None), str(error.format_message()).rstrip(".")
        return f"{said}; see '{context.command_path if context else 'submin'} --help'" if said else ""
    return str(error)


if __name__ == "__main__":
    main()
