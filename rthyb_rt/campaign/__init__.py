"""One test over lists, grids, seeds, records and drawn plants, on every processor there is.

`plan` makes a campaign's runs of its file, `running` carries one out, `pools` has many of them
carried out, `book` keeps what came of each as it comes, `page` and `tables` tell it.
"""
