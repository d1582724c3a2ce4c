"""``python -m maxcon`` is the command ``maxcon``."""

from maxcon.cli import main

main(prog_name="maxcon")
