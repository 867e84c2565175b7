"""The command line: ``crazysim`` or ``python -m crazysim``."""

from __future__ import annotations

import argparse
import os
import sys
import warnings
from collections.abc import Sequence
from typing import Any

from crazysim.commands import airframe, demo, info, replay, training
from crazysim.engine import cache
from crazysim.errors import DivergedError, RenderError, not_installed
from crazysim.lab.commands import identify, live, race, show, validate

EXTRAS = {"optax": "train", "matplotlib": "demo", "imageio_ffmpeg": "demo", "tqdm": "demo", "viser": "web",
          "websockets": "web", "onnx": "onnx", "motioncapture": "mocap", "cflib": "radio",
          "pymavlink": "mavlink", "flatbuffers": "tflite"}  # fmt: skip
"""Extra of crazysim that installs each package."""


class _Parser(argparse.ArgumentParser):
    # Each command refuses what it does not know, with its own usage instead of that of all commands.
    def parse_known_args(self, *args: Any, **options: Any) -> Any:
        known, unknown = super().parse_known_args(*args, **options)
        return self.error(f"unrecognized arguments: {' '.join(unknown)}") if unknown else (known, unknown)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return the exit status; without a command, print the help."""
    parser = _Parser(prog="crazysim", description="A drone simulator in which millions of worlds advance in one call.")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", dest="command")
    for module in (demo, replay, show, live, race, training, airframe, identify, validate, info):
        module.add_parsers(commands)
    options = parser.parse_args(arguments)
    if options.command is None:
        parser.print_help()
        return 0
    if options.command != "info":
        cache.enable_for_command()
    try:
        with warnings.catch_warnings():
            warnings.showwarning = lambda text, *_, **__: print(f"crazysim: {text}", file=sys.stderr)
            status = options.run(options)
        sys.stdout.flush()
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:  # the reader of the output, such as head, has closed it
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # Python flushes stdout at exit
        return 141
    except (ValueError, ImportError, OSError, DivergedError, RenderError) as error:
        print(f"crazysim: {_error_message(error, options.command)}", file=sys.stderr)
        return 2
    return status or 0


def _error_message(error: Exception, command: str) -> str:
    package = (error.name or "").partition(".")[0] if isinstance(error, ModuleNotFoundError) else ""
    if package not in EXTRAS:
        return str(error)
    return not_installed(f"'crazysim {command}' needs", package, EXTRAS[package])


if __name__ == "__main__":
    sys.exit(main())
