"""`python -m photonfarm.cli` is the command `photonfarm`."""

from photonfarm.cli.main import main

main()
