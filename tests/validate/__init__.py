"""A second generator of concealed cases, which shares no simulation with the first one; the proof.

`laws` and `motion` simulate, `fairness` judges from the information in the noise whether a case can
be decided, `recipes` draws the cases and `second` writes them. `own_rigs` hides effects in the
shipped rigs, `real` reads others' recordings; `proof` asks the tool, `page` says
how it went; `sensitivity` moves the tool's thresholds.
"""
