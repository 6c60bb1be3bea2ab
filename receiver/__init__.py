"""telepose receiver: from the wire to the person on the screen."""
