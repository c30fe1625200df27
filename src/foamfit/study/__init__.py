"""Several tests or cycles: each fitted on its own, and together."""
