"""The command line; `torchfilm.cli.main:main` is the entry point."""
