"""How results are shown: tables, pages, films, and files of other viewers."""
