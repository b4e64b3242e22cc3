"""``python -m quest``: the commands of ``quest``."""

from quest.cli.main import main

if __name__ == "__main__":
    raise SystemExit(main())
