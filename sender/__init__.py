"""telepose sender: from depth images to skeletons and candidate poses on the wire."""
