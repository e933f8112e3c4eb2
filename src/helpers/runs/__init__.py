"""One run of one notebook: what it was asked for, its verbs, its results on disk and what they were made from."""
