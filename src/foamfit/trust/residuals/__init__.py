"""What the residuals of a fit are made of: noise with its correlation, or an error of the law too.

`law_error` tells them apart by their spectra; `residual_tests` tests for structure.
"""
