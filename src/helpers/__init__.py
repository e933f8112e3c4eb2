"""Reproduction of "Using process data to generate an optimal control policy via apprenticeship and reinforcement
learning" (AIChE Journal, 2021, doi:10.1002/aic.17306): the helpers behind the notebooks."""
