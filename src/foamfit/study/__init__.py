"""Several tests or cycles: each fitted on its own, and together.

A newcomer reads `joint`, from a study file (`study_file`) to a result, or `cycles`, from a record
to its table; how tests are fitted together (`joint_fit`), and how the parameters that each cycle
has of its own are chosen (`shared`), may wait.
"""
