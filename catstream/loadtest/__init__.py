"""Load tests: real pipelines track a test stream that is sent at a fixed rate, whether or not they keep up."""
