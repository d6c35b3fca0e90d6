PATH=/opt/sgsst/bin:$PATH
