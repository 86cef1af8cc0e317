"""Numbers with units and ranges, and tables of them: what users may set."""
