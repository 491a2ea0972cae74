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
