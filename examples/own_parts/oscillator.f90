! A user's own numerical part in Fortran: m x'' + c x' + k x + force = -m ag by the central difference.
!
!   gfortran -O2 -shared -fPIC examples/own_parts/oscillator.f90 -o oscillator.so
module oscillator
  use iso_c_binding
  implicit none

  type, bind(C) :: part_setup            ! rthyb_part_setup of rthyb_library.h
    real(c_double) :: period_s
    type(c_ptr) :: parameter, k_e_n_per_m
  end type

  type, bind(C) :: part_state
    real(c_double) :: mass, damping, stiffness, h, x, x1
  end type

contains

  integer(c_int32_t) function version() bind(C, name="rthyb_part_version")
    version = 1
  end function

  integer(c_int32_t) function interfaces() bind(C, name="rthyb_part_interfaces")
    interfaces = 1
  end function

  subroutine names(of, text) bind(C, name="rthyb_part_names")
    integer(c_int32_t), value :: of
    character(kind=c_char), intent(out) :: text(*)
    character(len=:), allocatable :: said
    integer :: i
    said = ''
    if (of == 0) said = 'mass_kg damping_n_s_per_m stiffness_n_per_m'
    do i = 1, len(said)
      text(i) = said(i:i)
    end do
    text(len(said) + 1) = c_null_char
  end subroutine

  integer(c_int64_t) function state_bytes(setup) bind(C, name="rthyb_part_state_bytes")
    type(part_setup), intent(in) :: setup
    type(part_state) :: s
    state_bytes = storage_size(s) / 8
  end function

  integer(c_int32_t) function init(s, setup) bind(C, name="rthyb_part_init")
    type(part_state), intent(inout) :: s
    type(part_setup), intent(in) :: setup
    real(c_double), pointer :: p(:)
    call c_f_pointer(setup%parameter, p, [3])
    s%mass = p(1)
    s%damping = p(2)
    s%stiffness = p(3)
    s%h = setup%period_s
    init = merge(0, 1, s%mass > 0 .and. s%damping >= 0)
  end function

  integer(c_int32_t) function answer(s, ag, force, x_next) bind(C, name="rthyb_part_answer")
    type(part_state), intent(inout) :: s
    real(c_double), value :: ag
    real(c_double), intent(in) :: force(1)
    real(c_double), intent(out) :: x_next(1)
    real(c_double) :: half, net
    half = 0.5d0 * s%h * s%damping
    net = -s%mass * ag - s%stiffness * s%x - force(1)
    x_next(1) = s%x + ((s%mass - half) * (s%x - s%x1) + s%h**2 * net) / (s%mass + half)
    s%x1 = s%x
    s%x = x_next(1)
    answer = 0
  end function

end module
