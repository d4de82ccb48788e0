"""``python -m inspector``: the command, by the interpreter that is named."""

from inspector.cli.app import main

if __name__ == "__main__":
    main()
