"""One test from its files to its end: preparation, reference, conduct, operator, replay."""
