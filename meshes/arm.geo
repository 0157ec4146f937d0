// A rectangular arm of structured quadrilaterals.
//
// The inboard joint axis lies at the origin, the arm points along +x, the outboard reference
// point (the next joint's axis, or the end-effector) is (length, 0). Open this file in Gmsh and
// change the parameters on the left, or pass them with -setnumber, e.g. -setnumber length 0.8.

SetFactory("Built-in");

DefineConstant[
  length  = {1.0,  Min 0, Name "Parameters/1 length (m)"},
  height  = {0.06, Min 0, Name "Parameters/2 height (m)"},
  nx      = {200,  Min 1, Step 1, Name "Parameters/3 cells along"},
  ny      = {12,   Min 1, Step 1, Name "Parameters/4 cells across"},
  passive = {0.0,  Min 0, Name "Parameters/5 solid length at both ends (m)"}
];

// Whole cells whose centre lies within the passive length.
np = Ceil(passive / length * nx - 0.5);
solid_only = (2 * np >= nx);
h = length / nx;

// Stations along the arm: the ends, and the borders of the passive blocks where there are any.
If (np > 0 && !solid_only)
  stations = 4;
  x() = {0, np * h, length - np * h, length};
  n() = {np, nx - 2 * np, np};
Else
  stations = 2;
  x() = {0, length};
  n() = {nx};
EndIf

For i In {0 : stations - 1}
  Point(10 + i) = {x(i), -height / 2, 0};
  Point(20 + i) = {x(i),  height / 2, 0};
  Line(100 + i) = {10 + i, 20 + i};
  Transfinite Curve {100 + i} = ny + 1;
EndFor

design() = {};
solid() = {};
For i In {0 : stations - 2}
  Line(200 + i) = {10 + i, 11 + i};
  Line(300 + i) = {20 + i, 21 + i};
  Transfinite Curve {200 + i, 300 + i} = n(i) + 1;
  Curve Loop(400 + i) = {200 + i, 101 + i, -(300 + i), -(100 + i)};
  Plane Surface(500 + i) = {400 + i};
  Transfinite Surface {500 + i};
  Recombine Surface {500 + i};
  If (solid_only || (stations == 4 && i != 1))
    solid() += {500 + i};
  Else
    design() += {500 + i};
  EndIf
EndFor

Physical Curve("inboard", 1) = {100};
Physical Curve("outboard", 2) = {100 + stations - 1};
If (#design() > 0)
  Physical Surface("design", 3) = {design()};
EndIf
If (#solid() > 0)
  Physical Surface("passive", 4) = {solid()};
EndIf
