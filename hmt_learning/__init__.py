"""Learning for hmt_ros: motion files, rendering, training sets, and the commands that learn.

It imports hmt_ros, which never imports it: no robot needs it. It runs from the checkout, with what
`pip install hmt_ros[learning]` installs.
"""
