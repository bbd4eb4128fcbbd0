"""The worker queue: who computes what when. It knows nothing of photographs, grpc or metrics."""
