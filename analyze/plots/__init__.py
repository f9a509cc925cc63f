"""Pictures, each with its data as CSV beside it. Nothing here imports matplotlib before a picture is drawn."""
