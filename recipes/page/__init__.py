"""One HTML file to play with: policies, scenes and the modules of ``page/`` in it."""
