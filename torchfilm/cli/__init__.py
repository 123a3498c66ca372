"""The command line. Its entry point is `torchfilm.cli.main:main`."""
