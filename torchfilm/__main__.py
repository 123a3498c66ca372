"""`python -m torchfilm` is the command line."""

from torchfilm.cli.main import main

main()
