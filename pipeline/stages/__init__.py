"""The verbs, in the order of the route: render extract crop match fuse cluster correspond lift solve detect."""
