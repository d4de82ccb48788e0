"""What a controls engineer is given, made from the register table and the handshake's: pages, PLC code, a flow."""
