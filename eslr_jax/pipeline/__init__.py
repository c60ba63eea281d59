"""What stands around the core: formats, rigs, dressing, assets, report, pictures, page and commands.

It reads the core. The core does not know of it.
"""
