"""What is given: the values in params/, each with unit, source and status, as validated records."""
