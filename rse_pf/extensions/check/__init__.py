"""The verb check, which tracks a drive on this machine and shows what `client_sdk.check` finds wrong."""
