"""From a measurement and a model to the best parameters.

`problem` states what is fitted, `curves` what is compared, `objective` is the residual, `search`
finds its minimum in the coordinates of `box` by `levenberg`. A newcomer may skip `box`,
`weighing` and `branches`.
"""
