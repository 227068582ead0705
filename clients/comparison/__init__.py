"""The map beside other methods: one run, the same held-out points, all scans and fewer of them.

peers: methods that others wrote. study: who is built and what is scored. targets: what the map has
set out to reach. report: tables. figures: learning curves and reliability. command: `gpom compare`.
"""
