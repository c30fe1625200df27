"""Analysis of the residuals of a fit: correlated noise and model error.

`law_error` separates the two by their spectra; `residual_tests` tests for structure.
"""
