"""Learning for hmt_ros: motion files, rendering, training sets, and the commands that learn.

It imports hmt_ros, but hmt_ros never imports it, so robots do not need it. It runs from the
checkout, with the packages of `pip install hmt_ros[learning]`.
"""
