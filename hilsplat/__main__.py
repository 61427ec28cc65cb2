"""`python -m hilsplat` is the command `hilsplat`."""

from hilsplat.cli.main import main

main()
