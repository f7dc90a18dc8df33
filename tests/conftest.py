from hypothesis import settings

# The same examples in every run: a red run can be repeated, a green one is no luck.
settings.register_profile("repeatable", derandomize=True, deadline=None)
settings.load_profile("repeatable")
