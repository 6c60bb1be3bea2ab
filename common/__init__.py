"""telepose: what sender and receiver share (geometry, body, wire formats, transport, runtime)."""
