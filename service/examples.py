"""Values in examples of the API's documentation, which all describe one job."""

JOB_ID = "job_1a1fe701a104f943e9d4d8cce5b818c"
UPLOAD_ID = "upl_1a1fe701a104f943e9d4d8cce5b818c"
SHARE_ID = "shr_1a1fe701a104f943e9d4d8cce5b818c"
SHARE_TOKEN = f"{SHARE_ID}.Jx0o1qQz8m2kq3v4w5y6A7b8C9d0E1f2G3h4I5j6K7l"
SHA256 = "3158b524aebf9351a4de9039a6b9b799cfc0452d9cec424a9f867085d0a9a7b5"
