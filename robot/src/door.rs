//! Who may begin a handshake. Anybody can send first packets, from any address written on them; the places are few, so
//! that a flood costs little, and kept apart, so that it does not shut out everybody else.

use std::net::{IpAddr, Ipv6Addr};
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::Duration;

/// Handshakes and greetings at a time.
pub const PLACES: usize = 16;

/// Of these, for peers that have not shown that their address is theirs (RFC 9000 §8.1): with more of them inside, the
/// next is asked to come back with a token.
pub const UNPROVEN: usize = 4;

/// For one address, of IPv6 one /64.
pub const PER_ADDRESS: usize = 4;

/// Handshake and greeting take no longer than this, or the place is given to somebody else.
pub const STAY: Duration = Duration::from_secs(10);

/// The door of a robot.
#[derive(Debug, Clone, Default)]
pub struct Door(Arc<Mutex<Vec<Guest>>>);

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Guest {
    from: IpAddr,
    proven: bool,
}

/// What becomes of who knocks.
#[derive(Debug)]
pub enum Verdict {
    /// May begin; the place is free again when this is dropped.
    Enter(Place),
    /// Has to show first that its address is its own.
    Prove,
    /// No place, or none more for its address.
    Refuse,
}

/// A place inside.
#[derive(Debug)]
pub struct Place {
    door: Door,
    guest: Guest,
}

impl Door {
    /// Somebody knocks; `proven` if it brings a token that went to that address.
    pub fn knock(&self, from: IpAddr, proven: bool) -> Verdict {
        let guest = Guest {
            from: neighbourhood(from),
            proven,
        };
        let mut inside = self.inside();
        let count = |of: &dyn Fn(&Guest) -> bool| inside.iter().filter(|g| of(g)).count();
        if !proven && count(&|g| !g.proven) >= UNPROVEN {
            return Verdict::Prove;
        }
        // Whoever writes other people's addresses on its packets must not use up their places.
        let same = |g: &Guest| g.from == guest.from && g.proven == proven;
        if inside.len() >= PLACES || count(&same) >= PER_ADDRESS {
            return Verdict::Refuse;
        }
        inside.push(guest);
        drop(inside);
        Verdict::Enter(Place {
            door: self.clone(),
            guest,
        })
    }

    fn inside(&self) -> MutexGuard<'_, Vec<Guest>> {
        self.0
            .lock()
            .expect("no code panics while it holds the door")
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        let mut inside = self.door.inside();
        if let Some(i) = inside.iter().position(|g| *g == self.guest) {
            inside.swap_remove(i);
        }
    }
}

/// What one peer can have as many addresses of as it likes, as one.
fn neighbourhood(address: IpAddr) -> IpAddr {
    match address.to_canonical() {
        IpAddr::V6(v6) => IpAddr::V6(Ipv6Addr::from_bits(v6.to_bits() >> 64 << 64)),
        v4 => v4,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn address(n: u8) -> IpAddr {
        IpAddr::from([192, 0, 2, n])
    }

    fn enter(verdict: Verdict) -> Place {
        match verdict {
            Verdict::Enter(place) => place,
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn a_flood_from_made_up_addresses_leaves_places_for_real_ones() {
        let door = Door::default();
        let mut flood = Vec::new();
        for n in 0..200 {
            match door.knock(address(n), false) {
                Verdict::Enter(place) => flood.push(place),
                Verdict::Prove => {}
                Verdict::Refuse => panic!("told to go away, not to prove its address"),
            }
        }
        assert_eq!(flood.len(), UNPROVEN);
        // Its own address among them takes nothing from the operator.
        enter(door.knock(address(1), true));
    }

    #[test]
    fn one_address_does_not_take_every_place() {
        let door = Door::default();
        let held: Vec<_> = (0..PER_ADDRESS)
            .map(|_| enter(door.knock(address(1), true)))
            .collect();
        assert!(matches!(door.knock(address(1), true), Verdict::Refuse));
        enter(door.knock(address(2), true));
        drop(held);
        enter(door.knock(address(1), true));
    }

    #[test]
    fn a_network_of_ones_own_is_one_address() {
        let door = Door::default();
        let v6 = |host: u16| IpAddr::from([0x2001, 0xdb8, 0, 1, 0, 0, 0, host]);
        let _held: Vec<_> = (0..PER_ADDRESS as u16)
            .map(|n| enter(door.knock(v6(n), true)))
            .collect();
        assert!(matches!(door.knock(v6(99), true), Verdict::Refuse));
        let elsewhere = IpAddr::from([0x2001, 0xdb8, 0, 2, 0, 0, 0, 1]);
        enter(door.knock(elsewhere, true));
    }

    #[test]
    fn there_are_no_more_than_the_places() {
        let door = Door::default();
        let held: Vec<_> = (0..PLACES as u8)
            .map(|n| enter(door.knock(address(n), true)))
            .collect();
        assert!(matches!(door.knock(address(99), true), Verdict::Refuse));
        assert!(matches!(door.knock(address(99), false), Verdict::Refuse));
        drop(held);
        assert!(door.inside().is_empty());
    }
}
