"""`python -m photonfarm.shared.cli` is the command `photonfarm`."""

from photonfarm.shared.cli.main import main

main()
