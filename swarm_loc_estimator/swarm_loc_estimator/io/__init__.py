"""Files and bytes: swarm descriptions, bags, messages, datasets."""
