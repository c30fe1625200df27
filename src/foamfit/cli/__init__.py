"""The command line; its modules are imported here so that the group knows their commands.

Heavy modules are imported inside the commands that need them. A newcomer reads `fit`; `group` holds
exit codes and errors, `options` what several commands share.
"""

from foamfit.cli import fit, many, results, start  # noqa: F401
from foamfit.cli.group import main

__all__ = ["main"]
