"""From a historian file to a guarded controller of your own plant, and the example of a nonlinear tank."""
