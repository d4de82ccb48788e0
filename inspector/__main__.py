"""The command `inspector`, also as ``python -m inspector``."""

from __future__ import annotations

import gc
import sys
from pathlib import Path


def main() -> None:
    """Entry point of the command: its exit status by SystemExit."""
    match sys.argv[1:]:
        case ["run", "--config", file]:
            # As the service manager types it. What the registers wait for is not the parsing of options that are not
            # there, nor a look for garbage in what has just been imported.
            gc.disable()
            from inspector.service import serve

            raise SystemExit(serve.run(Path(file)))
        case _:
            from inspector.cli.app import app

            app()


if __name__ == "__main__":
    main()
