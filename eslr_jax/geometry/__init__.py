"""Host rooms on rest meshes: topology, validation, geodesics, embedding, padding, skin transfer."""
