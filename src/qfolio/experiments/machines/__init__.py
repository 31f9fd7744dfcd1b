"""Workers on one machine or many: where jobs run if not in this process.

One scheduler (``schedule``, ``dispatch``) gives jobs to workers, which are processes of this
machine (``processes``) or actors of a Ray cluster (``rays``). A worker (``worker``) knows nothing
of folders: jobs come in, news and results go out, and the driver alone writes files.
"""
