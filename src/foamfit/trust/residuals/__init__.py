"""The residuals of a fit: `law_error` separates correlated noise and model error by spectra."""
