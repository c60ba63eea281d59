"""The paper's networks, and others': `python experiments/paper SCRIPT`."""
