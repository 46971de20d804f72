"""The page: a local server and a page in the browser, from a scan to a report, nothing from a network.

`server` answers HTTP, `security` keeps strangers out, `intake` takes files in, `cases` and `choices` hold what a user
has chosen, `jobs` and `worker` run the long stages beside the server, `live` answers at once what a hand on the page
asks.
"""
