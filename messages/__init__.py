"""What the bytes mean: schemas, codecs and the catalogue of messages."""
