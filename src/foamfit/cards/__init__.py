"""Material cards of a fitted law for finite elements, and their deviation from the law.

`loading` computes the loading curves, evaluates a card as its solver does and fits its unloading;
`card` writes the files. The texts of the cards are templates.
"""
