"""One test over lists, grids, seeds, records and randomly drawn plants, on all processors.

`plan` derives a campaign's runs from its file, `running` carries out one run, `pools` many runs in
parallel, `book` stores each result as it arrives, `page` and `tables` present them.
"""
