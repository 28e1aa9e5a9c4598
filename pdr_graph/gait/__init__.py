"""The walker: attitude and samples to Steps."""
