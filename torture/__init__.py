"""What the project must survive, done to it: kills, notebooks side by side, mutated input. `make torture` runs all of it.

It stands beside the tests because it takes long and writes a report; the tests do a little of the same in each run.
"""
