"""From a measurement and a model to the best parameters.

`problem` states what is fitted, `objective` is the residual, `search` finds its minimum in the
coordinates of `box`. A newcomer may skip `box`.
"""
