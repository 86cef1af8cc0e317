"""Files and bytes: descriptions, bags, datasets, reports."""
