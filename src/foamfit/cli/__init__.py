"""The command line. Importing its modules registers their commands with the group.

Heavy modules are imported inside the commands that need them. Begin with `fit`; `group` has the
exit codes and the handling of errors, `options` the options shared by several commands.
"""

from foamfit.cli import fit, others  # noqa: F401
from foamfit.cli.group import main

__all__ = ["main"]
