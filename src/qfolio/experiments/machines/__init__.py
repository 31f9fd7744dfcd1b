"""Workers that run jobs outside this process, on one machine or many.

One scheduler (``schedule``, ``dispatch``) gives jobs to workers, which are processes of this
machine (``processes``) or actors of a Ray cluster (``rays``). A worker (``worker``) does not
access folders: it receives jobs and sends reports and results, and only the driver writes files.
"""
