"""The bytes of the robots: encoding and decoding, no I/O."""
