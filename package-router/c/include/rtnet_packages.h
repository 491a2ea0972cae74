/* Packages for programs in C: mailboxes of a station, and senders that lead to them. Link with -lrtnet_packages.
 *
 * Functions return 0 or what they say, or an error: a negative number of errno.h. rtnet_packages_error() says what it was.
 * A handle is used by one thread at a time; different handles by different ones. Those that take or give back handles allocate and
 * ask the station's broker; send, receive, peek and clean do not. NULL for a handle, or for a place that is to be written or
 * read, is -EINVAL. Numbers in bodies have the order that their head says; the heads here have this machine's.
 */
#ifndef RTNET_PACKAGES_H
#define RTNET_PACKAGES_H

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

typedef struct rtnet_component rtnet_component; /* a program that has come to a station */
typedef struct rtnet_mailbox rtnet_mailbox;     /* one of its mailboxes */
typedef struct rtnet_sender rtnet_sender;       /* a way from a mailbox to another */

/* The name of a mailbox: that of a component's commands has local 0. */
#define RTNET_MAILBOX_NAME(system, class_id, instance, local)                                                    \
    ((uint32_t)(system) << 24 | (uint32_t)(class_id) << 16 | (uint32_t)(instance) << 8 | (uint32_t)(local))

/* Kinds of replies; a server's own are less, commands are 1 to 127. */
#define RTNET_OK 0
#define RTNET_ERROR (-1)
#define RTNET_TIMEOUT (-2)
#define RTNET_NOT_AVAILABLE (-3)

/* Bytes of the largest body that there is. */
#define RTNET_LARGEST_BODY 262128

/* Of a receive that waits for ever, and of one that does not wait. */
#define RTNET_FOR_EVER (-1)
#define RTNET_AT_ONCE 0

/* What stands before a body. */
struct rtnet_head {
    uint32_t to;        /* whose it is */
    uint32_t from;      /* where a reply goes */
    uint32_t len;       /* bytes of the body */
    int8_t kind;        /* what it says: a command above 0, else a reply or data */
    uint8_t priority;   /* how urgent: larger is more; a reply has its command's */
    uint8_t id;         /* a reply has its command's */
    uint8_t big_endian; /* order of the numbers in the body: 0 little, 1 big */
};

/* What a mailbox is: all memory follows from it, slots x senders x bodies, and is taken when it is created. */
struct rtnet_shape {
    uint32_t slots;        /* packages of each sender that may wait: 1 to 1024 */
    uint32_t largest_body; /* bytes: 0 to RTNET_LARGEST_BODY */
    uint32_t senders;      /* 1 to 126 */
    uint32_t replace;      /* what finds no slot: 0 is refused, 1 takes the place of the oldest of the least urgent */
};

/* Of a time that nobody knows how long it was. */
#define RTNET_UNKNOWN_NS INT64_MIN

/* When a package was where: nanoseconds of global time, the master's, 0 where nobody knows. And where its time went, in nanoseconds, or
 * RTNET_UNKNOWN_NS. Of a package of this station `left` and `came` are 0, and `sent` is `delivered`. Stations' clocks are as far apart as
 * they are synchronised: what is shorter may be less than 0. */
struct rtnet_journey {
    uint64_t sent;           /* its sender sent it; one of another station says so with --package-times */
    uint64_t left;           /* the last of it left that station */
    uint64_t came;           /* the last of it came to this one */
    uint64_t delivered;      /* it was in the mailbox */
    uint64_t received;       /* it was received, or peeked at */
    int64_t slot_wait_ns;    /* from sent to left */
    int64_t wire_ns;         /* from left to came */
    int64_t router_ns;       /* from came to delivered, of a package from elsewhere */
    int64_t mailbox_ns;      /* from delivered to received, by this host's clock: always known */
    int64_t age_ns;          /* from sent to received */
    uint32_t from_elsewhere; /* 0 from this station, 1 from another */
    uint32_t reserved;       /* 0 */
};

/* What went wrong last in this thread: the error's name, where, and what to do about it. "" if nothing has. It is valid until the
 * next call of this function in this thread. */
const char *rtnet_packages_error(void);

/* Comes to a station, by the path of its broker's socket. -ENOENT, -ECONNREFUSED: there is none. */
int32_t rtnet_component_attach(const char *path, rtnet_component **component);
/* Comes to a TCP router instead, HOST or HOST:PORT, on a host without a station: packages for mailboxes that are not this process's go
 * there. `keys` is a directory of `rtnet router keys`, for a router that is reached by TLS; NULL: in the clear. Bodies may have up to
 * `largest_body` bytes, for which memory is reserved; 0: 4096. It does not wait for the router, and connects again by itself; without a
 * connection commands are answered RTNET_NOT_AVAILABLE. -EINVAL: that is no address, or these are no keys; -ENOENT: there are none. */
int32_t rtnet_component_of_router(const char *router, const char *keys, uint32_t largest_body,
                                  rtnet_component **component);

/* The connection of such a component. Counters are of all connections so far. */
struct rtnet_router_status {
    uint64_t connections;   /* opened */
    uint64_t sent;          /* packages written to the router */
    uint64_t received;      /* packages that came from it */
    uint64_t not_connected; /* packages dropped while there was no connection; commands were answered */
    uint64_t not_written;   /* packages lost with a connection before they were written */
    uint64_t unconfirmed;   /* packages of `sent` whose connection was lost before the router had confirmed them: some may have arrived */
    uint64_t lost_at_router; /* packages, and answers, that the router has read and not passed on: no connection has the name, or that has ended; no rule
                              * allows it; the queue is full */
    uint64_t names_refused; /* registrations that the router refused */
    uint64_t queue_full;    /* packages for the router that found its queue here full; commands were answered */
    uint64_t nobody_there;  /* packages from the router for a mailbox that is not here; commands were answered */
    uint64_t receiver_full; /* packages from the router that found their mailbox full; commands were answered */
    uint64_t too_large;     /* packages from the router that no slot of their mailbox holds; commands were answered */
    uint64_t foreign_senders; /* packages from the router in the name of a mailbox here */
    uint64_t answers_lost;  /* answers to the router that were not sent, since too many waited */
    uint32_t is_connected;  /* 1: there is a connection */
    uint32_t mailboxes;     /* registered at the router */
    uint32_t mailboxes_waiting; /* not registered: there is no connection, or another client has the name, or a rule forbids it */
    uint32_t reserved;      /* 0 */
    char last_error[160];   /* without a connection: the end of the last one, or the failure of the last attempt; "" */
};

/* -EOPNOTSUPP: the component is of a station. */
int32_t rtnet_component_router_status(const rtnet_component *component, struct rtnet_router_status *status);
/* Its mailboxes and senders stay until they are given back. Of a router: it waits for up to a second until that has read all that was
 * sent. NULL is nothing. */
void rtnet_component_detach(rtnet_component *component);

/* -EEXIST: the name is taken here. At a router it is registered later, and again each second if that is refused: see
 * rtnet_component_router_status. -EINVAL: there can be no such mailbox; -ENOSPC: the station has as many as it takes. */
int32_t rtnet_mailbox_create(rtnet_component *component, uint32_t name, const struct rtnet_shape *shape,
                             rtnet_mailbox **mailbox);
/* With what waits in it, and what was peeked at. NULL is nothing. */
void rtnet_mailbox_destroy(rtnet_mailbox *mailbox);

/* What is sent by it is from that mailbox. -ENOENT: there is none of that name; -EUSERS: it has all the senders that it takes. */
int32_t rtnet_sender_bind(rtnet_mailbox *from, uint32_t to, rtnet_sender **sender);
/* NULL is nothing. */
void rtnet_sender_unbind(rtnet_sender *sender);

/* Copies a package into the mailbox, in little-endian, with an id of its own: the id, 0 to 255. It never waits. -ENOBUFS: all slots
 * of this sender wait to be read, or to be sent to a TCP router. In the second case a command is answered RTNET_NOT_AVAILABLE, and
 * refused only while 256 wait for that answer. -EMSGSIZE: no slot holds it; -ENOENT: the mailbox is there no more, bind to it again; -EBADF: it
 * goes elsewhere, and the mailbox that it is from is there no more. */
int32_t rtnet_sender_send(rtnet_sender *sender, int8_t kind, const void *body, uint32_t len);
/* The same with that head's kind, priority, id and order; the rest is what it is. So a command is answered:
 *     struct rtnet_head reply = command;
 *     reply.kind = RTNET_OK;
 *     rtnet_sender_send_with(back, &reply, body, len); */
int32_t rtnet_sender_send_with(rtnet_sender *sender, const struct rtnet_head *head, const void *body, uint32_t len);
/* How urgent what rtnet_sender_send sends is from now on; at first by the sender's class. */
int32_t rtnet_sender_set_priority(rtnet_sender *sender, uint8_t priority);

/* Copies the most urgent package: bytes of its body. Waits so many nanoseconds at the most. -EAGAIN: there is none, at once;
 * -ETIMEDOUT: none came in time; -EMSGSIZE: there is too little room, it stays, and head->len is what it takes; -ENODEV: the
 * station has ended; -EBUSY: one is being peeked at. `head` may be NULL; so may `body` with a room of 0. */
int32_t rtnet_mailbox_receive(rtnet_mailbox *mailbox, struct rtnet_head *head, void *body, uint32_t room,
                              int64_t timeout_ns);

/* Lends the most urgent package, which stays in its slot until it is released or put back; only one is lent at a time, and
 * meanwhile all else that a mailbox does, binding included, is -EBUSY. Errors as of receive. */
int32_t rtnet_mailbox_peek(rtnet_mailbox *mailbox, struct rtnet_head *head, int64_t timeout_ns);
/* Copies of the body that is lent what is behind `skip` bytes, as far as it fits: how many bytes. -ENOMSG: nothing is lent. */
int32_t rtnet_mailbox_body(rtnet_mailbox *mailbox, uint32_t skip, void *into, uint32_t room);
/* Where the time of the package went that is lent. The component is the one that has the mailbox; it asks the station for its
 * time, which takes until that has sent what it is about to, until it has an answer: then it takes no system call. -ENOMSG: nothing
 * is lent. */
int32_t rtnet_mailbox_journey(const rtnet_component *component, rtnet_mailbox *mailbox, struct rtnet_journey *journey);
/* It is read, and its slot is its sender's again. -ENOMSG: nothing is lent. */
int32_t rtnet_mailbox_release(rtnet_mailbox *mailbox);
/* It stays, as the first of its priority. -ENOMSG: nothing is lent. */
int32_t rtnet_mailbox_put_back(rtnet_mailbox *mailbox);

/* Throws away what waits: how many. */
int32_t rtnet_mailbox_clean(rtnet_mailbox *mailbox);
/* How many wait. */
int32_t rtnet_mailbox_depth(rtnet_mailbox *mailbox);

#ifdef __cplusplus
}
#endif

#endif
