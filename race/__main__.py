"""``python -m race`` is the command ``race``."""

from race.cli import main

main()
