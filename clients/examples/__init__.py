"""One short script for each kind of use; run them with ``python -m clients.examples.NAME URL``."""
