"""The command line. Importing its modules registers their commands with the group.

Heavy modules are imported inside the commands that need them. Begin with `fit`; `options` has the
exit codes, the handling of errors, and what several commands share.
"""

from foamfit.cli import fit, others  # noqa: F401
from foamfit.cli.options import main

__all__ = ["main"]
