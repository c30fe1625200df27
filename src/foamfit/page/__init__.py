"""The page in the browser: `foamfit check` and `foamfit fit`, on this machine.

`server` controls access. `app` builds a window from `inputs` and `curves` (panels and sliders,
which a notebook uses too). `desk` manages the files, the test and the fit of a window. `worker`
runs the processes that fit and compile. `turning` computes the curves for parameters set by hand.
Begin with `desk`.
"""
