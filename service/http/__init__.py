"""The web interface: one module for each group of routes, put together by `app`."""
