"""`mapless-server serve`, also `python -m mapless_server`: one flag for each field of `Settings`.

Imports what serves only when it runs, so that --help answers at once.
"""

import asyncio
import gc
import inspect
import logging
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, NoReturn, get_args

import typer
from pydantic import SecretStr

from mapless_server import __version__
from mapless_server.settings import ConfigError, LoadedSettings, Settings, bounds_text, default_text, load_settings

from .libraries import configure_libraries

Config = Annotated[Path | None, typer.Option(help="TOML file of settings; also MAPLESS_CONFIG.")]


def _with_setting_flags(command: Callable[..., None]) -> Callable[..., None]:
    """Adds an option for each setting to a command that takes any keyword; an option that is not given is None.

    Secrets get no flag, because every user of the machine can read a command line.
    """
    *own, _ = inspect.signature(command, eval_str=True).parameters.values()
    flags = []
    for name, field in Settings.model_fields.items():
        kinds = [it for it in get_args(field.annotation) or (field.annotation,) if isinstance(it, type)]
        if SecretStr not in kinds:
            # A word from a closed list is plain text here: `Settings` checks it, wherever it comes from.
            kind: Any = kinds[0] if kinds else str
            default = default_text(name)
            values = "; ".join(filter(None, (bounds_text(name), default and f"default: {default}")))
            option = typer.Option(help=f"{field.description} ({values})" if values else field.description)
            annotation = Annotated[kind | None, option]
            flags.append(inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=annotation))
    vars(command)["__signature__"] = inspect.Signature([*own, *flags])
    return command


@_with_setting_flags
def serve_command(config: Config = None, **flags: Any) -> None:
    """Serve until SIGTERM. Every flag is also a setting of the file and of the environment, as MAPLESS_<FLAG>.

    `database_url` is a setting of these alone: every user of the machine can read a command line.
    """
    from mapless_server.observability.logs import configure_logging

    try:
        loaded = load_settings(flags, config)
    except ConfigError as error:
        fail(str(error))
    configure_logging(loaded.settings)
    _log_start(loaded)
    configure_libraries(loaded.settings)

    gc.disable()  # a fifth of the time of the imports, also of torch's; `serve` enables it when it is ready
    from .run import serve
    from .startup import StartupError

    try:
        asyncio.run(serve(loaded.settings))
    except StartupError as error:
        fail(str(error))


def _log_start(loaded: LoadedSettings) -> None:
    """Logs version and settings: a line for each for people, fields for programs."""
    log = logging.getLogger(__name__)
    if loaded.settings.log_format == "text":
        log.info("mapless-server %s\n%s", __version__, loaded)
    else:
        log.info("mapless-server %s", __version__, extra={"fields": loaded.fields})


def fail(message: str, code: int = 2) -> NoReturn:
    """Ends a command with one line on standard error and an exit code (2 for wrong usage)."""
    print(f"mapless-server: {message}", file=sys.stderr)
    raise typer.Exit(code)
