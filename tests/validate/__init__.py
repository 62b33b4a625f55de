"""A second generator of concealed cases, which shares no simulation with the first one.

`laws` and `motion` simulate, `fairness` judges from the information in the noise whether a case can
be decided, `recipes` draws the cases, `second` writes them and `run` puts them to the tool.
"""
