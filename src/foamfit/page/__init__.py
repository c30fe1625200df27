"""The page in the browser: everything that `foamfit check` and `foamfit fit` do, on this machine.

`server` guards the address, `app` builds one window from `widgets` (its inputs) and `curves`
(panels and sliders, which the notebook shows too), `desk` holds what a window works on, `worker`
has the processes that fit and compile, `turning` the curves of parameters that are turned by hand.
A newcomer reads `desk`.
"""
