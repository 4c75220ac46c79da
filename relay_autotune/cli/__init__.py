"""Commands that work without a ROS graph."""

import relay_autotune.threads  # noqa: F401
