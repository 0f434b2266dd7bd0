"""What each command of `turbogs` takes, checks and calls. What it calls is imported when it is called."""
