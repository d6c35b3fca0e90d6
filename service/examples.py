"""Values in examples of the API's documentation, which all describe one job."""

JOB_ID = "job_1a1fe701a104f943e9d4d8cce5b818c"
UPLOAD_ID = "upl_1a1fe701a104f943e9d4d8cce5b818c"
SHA256 = "3158b524aebf9351a4de9039a6b9b799cfc0452d9cec424a9f867085d0a9a7b5"
