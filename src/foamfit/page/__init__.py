"""The page in the browser: everything that `foamfit check` and `foamfit fit` do, on this machine.

`server` guards the address, `app` builds one window, `desk` holds what a window works on, `worker`
is the process that fits, `turning` has the curves of parameters that are turned by hand. A newcomer
reads `desk`.
"""
