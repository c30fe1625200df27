"""Several tests or cycles: each fitted on its own, and together.

A newcomer reads `cycles`, from a record to its table, `batch`, many tests side by side, and
`joint`, from a study file (`study_file`) to a result; how tests are fitted together (`joint_fit`)
and the `processes` of this machine may wait.
"""
