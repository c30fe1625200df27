"""The command line: one module for each command, imported here so that the group knows them.

Heavy modules are imported inside the commands that need them. A newcomer reads `fit`; `group` holds
exit codes and errors, `options` what several commands share.
"""

from foamfit.cli import batch, card, check, compare, fit, init, joint, page, predict, simulate  # noqa: F401
from foamfit.cli.group import main

__all__ = ["main"]
