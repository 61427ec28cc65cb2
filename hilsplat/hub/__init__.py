"""Released models: fetched from a model hub, checked, exported where no ready networks exist."""
