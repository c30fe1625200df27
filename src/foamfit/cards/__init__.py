"""Material cards: the curves of a fitted law for finite elements, and what they lose.

`curves` makes the loading curves, follows a card as its solver does and fits its unloading, `card`
makes the files. The texts of the cards are templates.
"""
