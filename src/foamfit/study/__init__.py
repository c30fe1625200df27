"""Several tests or cycles, fitted separately or together, and results read from their folders.

Start with `cycles` (the cycles of one record), `batch` (many separate tests) and `joint` (from a
study file, `study_file`, to a result). `joint_fit` has the fit of several tests with linked
parameters, `identified` results read from their folders, `predict` the prediction of another test
from one, and `processes` a process pool. `plan` chooses the next test: `draws` has the foams and
springs that would have given the records at hand, `gain` what a test would add.
"""
