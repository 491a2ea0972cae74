//! Programs that have sockets of a station, or its time: each connection is one socket's, as long as it lasts, or tells by its
//! end that there is no time any more.

use std::io::{ErrorKind, Read};

use rtnet::api::door::{self, Attached, Descriptors};
use rtnet::api::handshake::{self, Answer, Ask};
use rtnet::live::TimeBoard;
use socket2::Socket;

use super::server::Traffic;

/// Who answers.
pub trait Answers {
    /// A request: the reply.
    fn answer(&mut self, packet: &[u8], traffic: Traffic) -> Vec<u8>;
    /// What a program asks that has a socket, or is about to.
    fn ask(&mut self, _ask: Ask, _of: Option<&Attached>) -> (Answer, Option<(Attached, Descriptors)>) {
        (Answer::refused(nix::libc::EOPNOTSUPP), None)
    }
    /// The time, for whoever asks for it.
    fn time(&self) -> Option<&TimeBoard> {
        None
    }
    /// A program has gone, and left this.
    fn leave(&mut self, _left: Attached) {}
}

/// Who answers requests, and has no sockets for programs.
pub(super) struct Requests<F>(pub F);

impl<F: FnMut(&[u8], Traffic) -> Vec<u8>> Answers for Requests<F> {
    fn answer(&mut self, packet: &[u8], traffic: Traffic) -> Vec<u8> {
        (self.0)(packet, traffic)
    }
}

/// Who asked as a program does: its connection is its socket's.
pub(super) struct Program {
    pub socket: Socket,
    attached: Option<Attached>,
    /// It waits for the station's end.
    has_time: bool,
}

impl Program {
    /// Lets in who asks as a program does; `None`: it has got nothing.
    pub fn let_in(socket: Socket, packet: &[u8], answers: &mut impl Answers) -> Option<Self> {
        let mut program = Self { socket, attached: None, has_time: false };
        program.carry_out(packet, answers);
        (program.attached.is_some() || program.has_time).then_some(program)
    }

    /// Has it served, if it has something to say; `false`: it has gone, and what it had is given back.
    pub fn turn(&mut self, is_ready: bool, answers: &mut impl Answers) -> bool {
        let stays = !is_ready || self.serve(answers);
        if !stays {
            self.attached.take().into_iter().for_each(|left| answers.leave(left));
        }
        stays
    }

    /// `false`: it has gone.
    fn serve(&mut self, answers: &mut impl Answers) -> bool {
        let mut packet = [0; handshake::ASK_LEN + 1];
        match self.socket.read(&mut packet) {
            Ok(0) => false,
            Ok(length) => self.carry_out(&packet[..length], answers),
            Err(error) => matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted),
        }
    }

    /// `false`: it has not taken its answer.
    fn carry_out(&mut self, packet: &[u8], answers: &mut impl Answers) -> bool {
        let ask = Ask::parse(packet);
        if let (Some(Ask::Time), Some(time)) = (ask, answers.time()) {
            self.has_time = door::reply_with_time(&self.socket, time).is_ok();
            return self.has_time;
        }
        let (answer, opened) = match ask {
            Some(ask) => answers.ask(ask, self.attached.as_ref()),
            None => (Answer::refused(nix::libc::EPROTO), None),
        };
        let told = door::reply(&self.socket, &answer, opened.as_ref().map(|(_, descriptors)| descriptors));
        if let Some((attached, _)) = opened {
            self.attached = Some(attached);
        }
        told.is_ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::control::server::Server;
    use rtnet::api::door::{Door, Visit};
    use rtnet::api::line::Lines;
    use rtnet::buf::Buf;
    use rtnet::discipline::{Channel, SendError, TimeView};
    use rtnet::ip::route::Interface;
    use rtnet::ip::{Exit, Stack, StackConfig};
    use rtnet::live::{Bells, Visitor};
    use rtnet::queue::Priority;
    use rtnet::wire::ethernet::Address;
    use socket2::{Domain, SockAddr, Type};
    use std::time::Duration;

    struct Nowhere;

    impl Exit for Nowhere {
        fn send(&mut self, frame: Buf, _: Priority, ch: Channel) -> Result<(), (SendError, Buf)> {
            Err((SendError::NoSlot(ch), frame))
        }
        fn limit(&self, channel: Channel) -> Result<usize, SendError> {
            Err(SendError::NoSlot(channel))
        }
        fn time(&self) -> TimeView {
            TimeView::default()
        }
    }

    /// A station that takes its time for everything but openings.
    struct Slow {
        stack: Stack,
        door: Door,
        asked: usize,
        left: usize,
        requests: usize,
    }

    impl Slow {
        fn let_in(&mut self, mut visit: Visit) -> Visit {
            visit.visit(&mut self.stack, &mut Nowhere);
            visit
        }
    }

    impl Answers for Slow {
        fn answer(&mut self, _: &[u8], _: Traffic) -> Vec<u8> {
            self.requests += 1;
            b"done".to_vec()
        }
        fn ask(&mut self, ask: Ask, of: Option<&Attached>) -> (Answer, Option<(Attached, Descriptors)>) {
            if of.is_some() {
                self.asked += 1;
                std::thread::sleep(Duration::from_millis(25));
            }
            match self.door.prepare(ask, of) {
                Ok(visit) => {
                    let visit = self.let_in(visit);
                    self.door.finish(visit)
                }
                Err(answer) => (answer, None),
            }
        }
        fn leave(&mut self, left: Attached) {
            self.left += 1;
            let visit = self.door.leave(left);
            let visit = self.let_in(visit);
            drop(self.door.finish(visit));
        }
    }

    #[test]
    fn programs_that_ask_what_takes_long_are_served_one_a_call_and_clients_beside_them() {
        let scratch = tempfile::tempdir().unwrap();
        let path = scratch.path().join("arm.sock");
        let mut server = Server::bind(&path).unwrap();
        let interface = Interface { address: Address::default(), ip: [10, 0, 0, 1].into(), prefix: 24 };
        let stack = Stack::new(StackConfig::new(interface), vec![Box::new(Lines::new(8))]);
        let mut slow = Slow { stack, door: Door::new(Bells::new().unwrap()), asked: 0, left: 0, requests: 0 };
        let connect = || {
            let socket = Socket::new(Domain::UNIX, Type::SEQPACKET, None).unwrap();
            socket.connect(&SockAddr::unix(&path).unwrap()).unwrap();
            socket
        };
        let (programs, client): (Vec<_>, _) = ((0..4).map(|_| connect()).collect(), connect());
        assert!(programs.iter().all(|program| program.send(&Ask::OpenUdp(0).to_bytes()).is_ok()));
        (0..5).for_each(|_| server.serve_all(Duration::ZERO, &mut slow));
        assert_eq!(slow.stack.sockets().count(), programs.len());
        for call in 1..=programs.len() {
            // Whoever was served asks at once again.
            for program in &programs {
                program.send(&Ask::LocalAddress.to_bytes()).unwrap();
            }
            client.send(b"?").unwrap();
            server.serve_all(Duration::ZERO, &mut slow);
            assert_eq!(
                (slow.asked, slow.requests),
                (call, call),
                "one that takes long, and who takes no time"
            );
        }
        // Whose turn it is goes round: each was served once, and each has as many answers.
        let mut answer = [0; 64];
        for program in &programs {
            program.set_nonblocking(true).unwrap();
            let mut from = program;
            assert!((0..2).all(|_| from.read(&mut answer).is_ok()));
            assert!(from.read(&mut answer).is_err());
        }
        drop(programs);
        (0..40).for_each(|_| server.serve_all(Duration::ZERO, &mut slow));
        assert_eq!((slow.left, slow.stack.sockets().count()), (4, 0));
    }
}
