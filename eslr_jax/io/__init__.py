"""Files: one format a module, reader beside writer; everything is written whole or not at all."""
