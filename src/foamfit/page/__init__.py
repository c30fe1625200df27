"""The page in the browser: `foamfit check` and `foamfit fit`, on this machine.

`server` controls access, `app` builds one window from `widgets` (inputs) and `curves` (panels and
sliders, also used in a notebook), `desk` holds the files, the test and the fit of a window,
`worker` runs the processes that fit and compile, and `turning` computes the curves for parameters
set by hand. Begin with `desk`.
"""
