"""The page in the browser: everything that `foamfit check` and `foamfit fit` do, on this machine.

`server` guards the address, `app` builds one window from `fields` (the options of the command) and
`curves` (panels and sliders, which the notebook shows too), `desk` holds what a window works on,
`worker` is the process that fits, `first_use` the one that compiles, `turning` has the curves of
parameters that are turned by hand. A newcomer reads `desk`.
"""
