"""The page of `rtc latency`."""
