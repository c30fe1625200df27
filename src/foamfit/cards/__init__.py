"""Material cards of a fitted law for finite elements.

`loading` computes and fits their curves as each solver does; `card` writes the files by templates.
"""
