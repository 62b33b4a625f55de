"""One test from its files to its end: preparation, reference, course, operator, replay."""
