"""Who may do what: tokens, TLS, tenancy, the address that may be listened on, and each tenant's computing time.

May import method, networks, images and scheduling, and uses none of them. Begin with `protection.Protection`, which is
made from the settings, and `access.METHOD_ROLES`, the role that each method takes. `tenancy` has the keys of scenes,
which all rooms below the services use. Modules are imported one by one: a store needs keys of scenes, and no TLS.
"""
