"""Several tests or cycles: each fitted on its own, and together.

A newcomer reads `cycles`, from a record to its table; how the parameters that are each cycle's own
are chosen (`shared`) may wait.
"""
