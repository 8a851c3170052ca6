"""The command line."""

from sgns.cli.commands import COMMANDS, main, run_command

__all__ = ["COMMANDS", "main", "run_command"]
