"""What shows a recording: windows, web pages, screenshots, videos, summaries and exports."""
