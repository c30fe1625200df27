"""Several tests or cycles: each fitted on its own, and together.

A newcomer reads `cycles`, from a record to its table, and `batch`, many tests side by side; how the
parameters that are each cycle's own are chosen (`shared`) and the `processes` of this machine may
wait.
"""
