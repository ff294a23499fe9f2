"""The receiver's part in a record: impulse response, digitiser tables, offsets."""
