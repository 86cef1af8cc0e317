"""The report of a replay: table, pictures, page."""
