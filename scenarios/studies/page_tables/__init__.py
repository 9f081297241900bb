"""Tables of the pages, from files of results."""
