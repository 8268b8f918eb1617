"""The queue: RQ, whose jobs are only names, and `reconcile`, which fills it from the store.

Redis is disposable: every job in it can be derived again from plans and markers. Our keys, beside RQ's:

rq:worker:<name>, field photonfarm      what a worker tells of itself
rq:photonfarm:reconcile                 lock of the process that fills the queue
rq:photonfarm:looked:<scene id, or all> what the last look at the store found, for seconds
rq:photonfarm:store                     the id of the store that this Redis serves, while it is in use
rq:photonfarm:consumed:<scene id>       samples of a scene that its trainer has used
"""
