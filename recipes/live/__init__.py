"""The simulation in a browser, as it runs: the real MuJoCo environment under one's hands."""
