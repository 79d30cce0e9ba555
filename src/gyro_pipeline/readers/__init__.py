"""A logger's file in, a raw log in deg/s out."""
