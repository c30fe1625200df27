"""From a measurement and a model to the best parameters.

`problem` defines the parameters, `curves` the measured curves, `objective` the residual. `search`
minimises it with `levenberg` in the coordinates of `box`. Skip `box` at first reading.
"""
